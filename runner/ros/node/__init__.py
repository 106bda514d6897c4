"""The node: run by a Python that has rclpy (ROS 2) or rospy (ROS 1), in a process of its own.

It imports the standard library and ROS, and nothing else of this project, which that Python does not have.

start     runs the node of a version
port      the socket to the process that starts the node, over which JSON passes
pictures  pictures of topics on their way to that process, and back
inputs    other topics, whose messages are passed on
ros1      the node of ROS 1
ros2      the node of ROS 2

To the node: first its task, then orders: texts to publish, pictures to publish, and answers to calls of services. From
the node: messages with the key "kind". Either way a picture comes with a file descriptor of the memory that holds its
data. The node ends with its socket.
"""
