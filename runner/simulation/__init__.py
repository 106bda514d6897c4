"""The closed loop of cameras, link, reports and rules without video and without a clock: an evaluation tool. Pure.

`drive` runs the same rules engine as the vehicle: reception reports go through `runner.vehicle.uplink`, its
measurements and all other events through `runner.core.step`, and the commands turn simulated encoders.
"""
