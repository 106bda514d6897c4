"""ROS: a node in a process of its own, run by a Python that has rclpy or rospy, and what is made of its messages.

process  starts the node, starts it again, receives from it
cameras  pictures of topics for cameras: checks, reports
inputs   operator inputs as topics and services
pictures decoded pictures of the operator's side as topics
node     what the other Python runs; it imports nothing of the rest of this project
"""
