"""usage: tod-runner ros [OVERRIDE ...] [duration_s=N]

Bridges the vehicle's control link to ROS topics and services, by a node in its own process, on either side. Needs an
MQTT broker at control.host, and rclpy for ros.python: `make ros2`. With ros.version=1 it needs rospy, `make ros1`, and
a ROS master. Ends with Ctrl-C or after duration_s.

All text messages are std_msgs/String. Outputs: ~/state and ~/telemetry as the vehicle publishes them
(schemas/control.schema.json), and the RTSP address of each camera on ~/url/CAMERA, latched for late subscribers such as
rtsp_image_transport. Inputs: ~/request, an event of schemas/event.schema.json with `id`; each is answered on ~/reply as
applied, refused, expired or timed out. Operator inputs without JSON: services ~/mode/MODE (std_srvs/Trigger) and
~/camera/CAMERA/switch (SetBool), topics ~/total_kbps, ~/camera/CAMERA/kbps, scaling (std_msgs/Float64) and roi
(sensor_msgs/RegionOfInterest), and ~/operator_connected (std_msgs/Empty) while somebody operates the vehicle.
With ros.position, a topic of sensor_msgs/NavSatFix provides the vehicle's position; with ros.prediction, a topic of
std_msgs/Float64 predicts the bitrate, kbit/s, provided that only the named node publishes it. See docs/ros.md.

  tod-runner ros vehicle=delivery_robot
  tod-runner ros vehicle=delivery_robot ros.version=1
  tod-runner ros ros.position=/gps/fix 'ros.prediction={topic: /pqos/kbps, node: /pqos}'
"""

from __future__ import annotations

import time

from runner.configuration.config import configuration
from runner.system import signals
from runner.system.signals import stopping
from runner.verbs import Arguments
from runner.verbs.screen import say

LOOK_S = 0.1


def run(arguments: Arguments) -> int:
    signals.hold()
    from runner.ros.bridge import Bridge
    from runner.ros.process import check_discovery
    from runner.security.exposure import keyring_of

    duration = arguments.number("duration_s")
    setup = configuration(arguments.overrides, arguments.conf, site=arguments.site, runnable=False).setup()
    check_discovery(setup.ros, setup.insecure)
    bridge = Bridge(setup, keyring_of(setup), say)
    try:
        bridge.start()
        say(f"requests have the id {bridge.identity}")
        began = time.monotonic()
        with stopping() as stop:
            while not stop.wait(LOOK_S) and (duration is None or time.monotonic() - began < duration):
                bridge.time_out()
    finally:
        bridge.close()
    return stop.status
