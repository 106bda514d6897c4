"""ROS: a node in its own process, run by a Python that has rclpy or rospy, and the use of its messages.

process  starts and restarts the node, receives from it
cameras  pictures of topics for cameras: checks, reports
inputs   operator inputs as topics and services
pictures decoded pictures of the operator's side as topics
node     the code that the other Python runs; it imports nothing else of this project
"""
