"""The node: run by a Python that has rclpy (ROS 2) or rospy (ROS 1), in its own process.

It imports only the standard library and ROS, since that Python does not have the rest of this project.

start     runs the node of a ROS version
port      the socket to the process that starts the node, which carries JSON
pictures  pictures of topics on their way to that process, and back
inputs    other topics whose messages are passed on
ros1      the node of ROS 1
ros2      the node of ROS 2

To the node: first its task, then orders: texts and pictures to publish, and answers to service calls. From the node:
messages with the key "kind". In both directions a picture comes with a file descriptor of the memory that contains its
data. The node ends when its socket is closed.
"""
