"""ROS 2: a node in a process of its own, run by a Python that has rclpy, and what this process makes of its messages.

process  starts the node, starts it again, receives from it
cameras  pictures of topics for cameras: checks, reports
inputs   operator inputs as topics and services
pictures decoded pictures of the operator's side as topics
node     the script that the other Python runs; it imports nothing of this project
"""
