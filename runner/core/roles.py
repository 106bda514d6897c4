"""Access rights: which role may request what of a vehicle. Pure."""

from __future__ import annotations

from enum import StrEnum


class Role(StrEnum):
    """Role of a holder of keys."""

    VEHICLE = "vehicle"
    BROKER = "broker"
    CONTROLLER = "controller"  # an operator who may drive
    SUPERVISOR = "supervisor"  # one who may also take control from another
    WATCHER = "watcher"  # sees what the operator sees
    PREDICTOR = "predictor"  # pQoS
    POSITIONER = "positioner"  # localisation and odometry, where they are not on the vehicle


PRESENCE = frozenset({"operator_connected", "operator_disconnected"})
DRIVER_EVENTS = frozenset(
    {"mode_selected", "total_set", "camera_switched", "roi_set", "camera_configured", "weights_set", "moment_marked"}
)
STOP_REQUESTED = "stop_requested"  # by whoever sees what happens
CONTROL_EVENTS = frozenset(
    {f"control_{what}" for what in ("requested", "offered", "accepted", "denied", "released")}
    | {STOP_REQUESTED, "stop_lifted"}
)
MAY_REQUEST: dict[Role, frozenset[str]] = {
    Role.CONTROLLER: PRESENCE | DRIVER_EVENTS | CONTROL_EVENTS,
    Role.SUPERVISOR: PRESENCE | DRIVER_EVENTS | CONTROL_EVENTS | {"control_taken"},
    Role.WATCHER: PRESENCE | {STOP_REQUESTED},
    Role.PREDICTOR: frozenset({"bitrate_predicted"}),
    Role.POSITIONER: frozenset({"position_reported", "steering_reported"}),
    Role.VEHICLE: frozenset(),
    Role.BROKER: frozenset(),
}
DRIVERS = (Role.CONTROLLER, Role.SUPERVISOR)  # those that may be in control
VIEWERS = (*DRIVERS, Role.WATCHER)  # those that see pictures
PEOPLE = (*VIEWERS, Role.PREDICTOR, Role.POSITIONER)  # those that may request anything


def denial(role: Role | None, event: str) -> str | None:
    """Why a sender may not request an event; None if it may.

    role   None: a sender unknown to the vehicle's keys
    event  its name in schemas/event.schema.json
    """
    if role is None:
        return "unknown operator: not listed in the vehicle's keys"
    if event in MAY_REQUEST[role]:
        return None
    takers = [other.value for other in PEOPLE if event in MAY_REQUEST[other]]
    if not takers:
        return f"a {role} may not request this event; only the vehicle generates it"
    return f"a {role} may not request {event}; only {' or '.join(takers)} may"
