"""Settings of a run that no rule reads: addresses, page, logs, keys, ROS. Frozen, valid once built."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from runner.core.budget import sound_kbps
from runner.core.model import Camera, Element, Kbps, ModelError, Vehicle, check_unique
from runner.errors import suggest
from runner.redact import has_password

if TYPE_CHECKING:
    from ipaddress import IPv4Network, IPv6Network


PREFIX = "tod"  # of topics


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Address at which a server listens and its clients reach it."""

    host: str
    port: int

    def __str__(self) -> str:
        """As in a URL: an IPv6 address is in brackets (RFC 3986, section 3.2.2)."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


@dataclass(frozen=True, slots=True)
class ForeignBroker:
    """How a side logs in to a broker that `tod-runner keys` did not set up, which proves its name by its certificate.

    ca              file with certificates of its authority, and the revocation list if that counts; None: that of the
                    keys, without keys those of the system
    credentials     file with one line user:password; None: none
    certificate     file with the certificate that this side presents; None: that of the keys, if there are no
                    credentials
    key             file with its private key; None: the same file
    topics_guarded  whether it lets everybody write to their own topics only
    """

    ca: str | None = None
    credentials: str | None = None
    certificate: str | None = None
    key: str | None = None
    topics_guarded: bool = False

    def __post_init__(self) -> None:
        if self.key and not self.certificate:
            raise ModelError("key", self.key, "must come with the certificate that it belongs to", "certificate")


@dataclass(frozen=True, slots=True)
class Control(Endpoint):
    """The MQTT broker.

    prefix    what all topics begin with
    foreign   None: `tod-runner keys` set it up, or it asks for no keys
    embedded  whether this side starts it
    """

    prefix: str = PREFIX
    foreign: ForeignBroker | None = None
    embedded: bool = False

    @staticmethod
    def of(data: Mapping[str, Any]) -> Control:
        """From the section `control` of a configuration.

        raises  ModelError for keys of a foreign broker although it is none, for a password in place of its file, and
                for a foreign broker that this side is to start
        """
        given = {each.name: data[each.name] for each in fields(ForeignBroker) if data.get(each.name)}
        if given and not data.get("foreign"):
            first, *others = given
            rule = "is for a broker that `tod-runner keys` did not set up: give control.foreign=true"
            raise ModelError(first, given[first], rule, *others)
        if ":" in given.get("credentials", ""):
            raise ModelError("credentials", "***", "must be the name of a file with one line user:password, not these")
        if data.get("broker") and data.get("foreign"):
            raise ModelError(
                "broker", data["broker"], "must not be given: control.foreign is another broker", "foreign"
            )
        foreign = ForeignBroker(**given) if data.get("foreign") else None
        return Control(data["host"], data["port"], data.get("prefix", PREFIX), foreign, bool(data.get("broker")))


@dataclass(frozen=True, slots=True)
class Media(Endpoint):
    """The vehicle's RTSP server.

    rtp_ports          first and last UDP port for RTP and RTCP; a camera takes two
    session_timeout_s  a viewer that sends neither requests nor RTCP for this long is dropped
    max_viewers        simultaneous viewers of one camera outside the vehicle
    watcher_copies     whether they may be watchers, a role of keys
    secure             whether it serves RTSP over TLS, with SRTP
    """

    rtp_ports: tuple[int, int]
    session_timeout_s: int
    max_viewers: int
    watcher_copies: bool = False
    secure: bool = False

    def __post_init__(self) -> None:
        first, last = self.rtp_ports
        if first >= last:
            raise ModelError("rtp_ports", f"[{first}, {last}]", "must be [first, last], first below last")
        if self.watcher_copies and self.max_viewers < 2:
            rule = "must be false while max_viewers is 1: the operator in control would take the watcher's place"
            raise ModelError("watcher_copies", "true", rule)


@dataclass(frozen=True, slots=True)
class Uplink:
    """A way from the vehicle to its operators: all that leaves by one network device, or from one address.

    interface  name of the device, such as wwan0
    address    of the device, where routes decide by it which device a packet leaves by
    """

    interface: str | None = None
    address: str | None = None


FROZEN_MS = 120  # a picture that stands for this long is marked within 150 ms
FROZEN_INTERVALS = 1.3  # and for so many frame intervals, see `frozenAfter` in page/static/status.js


@dataclass(frozen=True, slots=True)
class PageSettings:
    """The operator's page.

    host     address at which it is served
    late_ms  age when drawn above which a picture is marked as late
    people   file of those who may log in beside the operator; None: nobody
    """

    serve: bool
    port: int
    late_ms: float
    host: str = "127.0.0.1"
    people: str | None = None

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint(self.host, self.port)


@dataclass(frozen=True, slots=True)
class Inputs:
    """Keys and buttons of the operator's page, by action; None: the action has none.

    keys     names in the browser's KeyboardEvent.key
    buttons  numbers in the browser's Gamepad API, or directions of an axis as the page names them
    """

    keys: Mapping[str, str | None] = field(default_factory=dict)
    buttons: Mapping[str, int | str | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, given in (("keys", self.keys), ("buttons", self.buttons)):
            taken: dict[str | int, str] = {}
            for action, value in given.items():
                if value is not None and value in taken:
                    rule = f"is already assigned to {taken[value]}"
                    raise ModelError(f"{kind}.{action}", repr(value), rule, f"{kind}.{taken[value]}")
                if value is not None:
                    taken[value] = action


@dataclass(frozen=True, slots=True)
class LatencyLimit:
    """Limits the speed by latency.

    limit_ms  glass-to-glass latency up to which the vehicle may go at full speed
    fixed_ms  the part of it that is not measured: exposure to capture time, decoding to light; None: unknown
    """

    limit_ms: float = 200.0
    fixed_ms: float | None = None

    def speed_factor(self, measured_ms: float | None) -> float | None:
        """Advised share of full speed: the limit over the total latency, at most 1; None without `fixed_ms`.

        measured_ms  from capture to decoding, at most; None: unknown, which advises to stop
        """
        if self.fixed_ms is None:
            return None
        return 0.0 if measured_ms is None else min(1.0, self.limit_ms / max(measured_ms + self.fixed_ms, 1e-3))


@dataclass(frozen=True, slots=True)
class MetricsPorts:
    """TCP ports on 127.0.0.1 at which each side serves its metrics; None: not served."""

    vehicle_port: int | None = None
    operator_port: int | None = None


@dataclass(frozen=True, slots=True)
class RosQos:
    """QoS requested by a subscription to a ROS 2 topic; None: what its publishers offer.

    depth  queue length; the oldest messages are dropped first
    """

    reliability: str | None = None
    durability: str | None = None
    depth: int = 10


@dataclass(frozen=True, slots=True)
class RosPrediction:
    """Bitrate predictions on a ROS topic, accepted from one node only, given by its full name."""

    topic: str
    node: str


ROS_PYTHON = {1: "/usr/bin/python3", 2: ".venv-ros2/bin/python"}  # by version
OF_ROS_2 = {  # keys without effect in ROS 1, and why
    "use_sim_time": "a node follows the parameter /use_sim_time of its master",
    "discovery": "ROS_MASTER_URI names the master, which knows all nodes",
    "qos": "subscribers cannot request QoS",
}


@dataclass(frozen=True, slots=True)
class RosSettings:
    """The ROS node, which runs in its own process.

    version       of ROS, 1 or 2
    python        interpreter that can import rclpy or rospy; None: that of `make ros2` or `make ros1`
    node          its name
    namespace     absolute
    remap         actual names of topics and nodes, by the names used here
    use_sim_time  whether stamps refer to the time on /clock; ROS 2 only
    discovery     range of discovery: off, localhost, subnet, system_default; ROS 2 only
    qos           by topic; ROS 2 only
    position      topic with the vehicle's position, for the verb `ros`; None: none
    prediction    topic with predictions, for the verb `ros`; None: none
    pictures      whether the operator's side publishes what it decodes
    """

    version: int = 2
    python: str | None = None
    node: str = "tod_runner"
    namespace: str = "/"
    remap: Mapping[str, str] = field(default_factory=dict)
    use_sim_time: bool = False
    discovery: str = "localhost"
    qos: Mapping[str, RosQos] = field(default_factory=dict)
    position: str | None = None
    prediction: RosPrediction | None = None
    pictures: bool = False

    @property
    def interpreter(self) -> str:
        return self.python or ROS_PYTHON[self.version]

    def misplaced(self) -> Iterator[ModelError]:
        """Keys that are set but have no meaning in this version of ROS."""
        if self.version == 1:
            unset = RosSettings()
            for key, rule in OF_ROS_2.items():
                if getattr(self, key) != getattr(unset, key):
                    yield ModelError(key, None, f"has no effect with ros.version=1: {rule}", "version")


@dataclass(frozen=True, slots=True)
class Recording:
    """How frames are recorded without loss, as defined in YAML.

    codec     its name, for display and for recording.json
    of_raw    upper bound of a file's size as a share of the raw frames' size
    elements  from raw frames to a Matroska stream, may hold {placeholders}
    needs     by element that only the vehicle may have, the Debian package that provides it
    """

    codec: str
    of_raw: float
    elements: tuple[Element, ...]
    needs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_unique("elements", [element.name for element in self.elements])


@dataclass(frozen=True, slots=True)
class Sound:
    """The vehicle's sound, as defined in YAML: elements may hold {placeholders}.

    kbps              of the Opus stream, without headers
    packet_ms         of sound in a packet
    header_bytes      of a packet on the wire
    jitter_buffer_ms  how long the operator waits for a missing packet
    dscp              DiffServ code point of the packets; -1 leaves it to the system
    port              UDP port in the lines that `print` shows
    source            elements that produce raw sound; `vehicle` and `operator` follow as in a camera's graph
    device, clip      microphone and file, for the source; None: none is named
    needs             by element that only the vehicle may have, the Debian package that provides it
    """

    kbps: int
    packet_ms: int
    header_bytes: int
    jitter_buffer_ms: int
    dscp: int
    port: int
    source: tuple[Element, ...]
    vehicle: tuple[Element, ...]
    operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    device: str | None = None
    clip: str | None = None
    needs: Mapping[str, str] = field(default_factory=dict)

    @property
    def wire_kbps(self) -> Kbps:
        """Of one copy, with headers."""
        return sound_kbps(self.kbps, self.packet_ms, self.header_bytes)

    @property
    def needs_clip(self) -> bool:
        return any(value == "{clip}" for element in self.source for value in element.properties.values())


@dataclass(frozen=True, slots=True)
class Voice:
    """The operator's voice at the vehicle's loudspeaker, as defined in YAML: elements may hold {placeholders}.

    jitter_buffer_ms  how long the vehicle waits for a missing packet
    operator          elements from the page's microphone to the RTSP client
    vehicle           elements behind the RTSP server, in front of the loudspeaker
    loudspeaker       elements that play raw sound
    device, file      for the loudspeaker; None: none is named
    others            as in `Sound`
    """

    kbps: int
    packet_ms: int
    header_bytes: int
    jitter_buffer_ms: int
    dscp: int
    port: int
    operator: tuple[Element, ...]
    vehicle: tuple[Element, ...]
    loudspeaker: tuple[Element, ...]
    wire_microphone: tuple[Element, ...]
    wire_operator: tuple[Element, ...]
    wire_vehicle: tuple[Element, ...]
    device: str | None = None
    file: str | None = None
    needs: Mapping[str, str] = field(default_factory=dict)

    @property
    def needs_file(self) -> bool:
        return any(value == "{file}" for element in self.loudspeaker for value in element.properties.values())


@dataclass(frozen=True, slots=True)
class Dimensions:
    """The vehicle seen from above, m: what the page draws on the ground.

    wheelbase_m      between the axles
    track_m          between the middles of the wheels of an axle
    width_m          at its widest
    front_m, rear_m  from the rear axle to the front and to the rear end
    """

    wheelbase_m: float
    track_m: float
    width_m: float
    front_m: float
    rear_m: float

    def __post_init__(self) -> None:
        if self.front_m < self.wheelbase_m:
            rule = f"must reach the front axle, {self.wheelbase_m:g} m ahead"
            raise ModelError("front_m", f"{self.front_m:g}", rule, "wheelbase_m")
        if self.track_m > self.width_m:
            rule = f"must be at most width_m, {self.width_m:g}"
            raise ModelError("track_m", f"{self.track_m:g}", rule, "width_m")


WHOLE = ".lossless"  # in the names of files with whole pictures that a drive keeps, behind the camera's


@dataclass(frozen=True, slots=True)
class Lossless:
    """How much of a camera's whole pictures a drive keeps without loss.

    for_s    length of a part, s; at most every_s
    every_s  from the beginning of a part to that of the next, s; for_s: they follow one another
    most_gb  of all parts of a drive, 10^9 bytes
    """

    for_s: float = 5.0
    every_s: float = 60.0
    most_gb: float = 10.0


@dataclass(frozen=True, slots=True)
class LogSettings:
    """What is logged of a drive, and which drives stay.

    video      whether that holds the video of every camera
    lossless   by camera, how much of its whole pictures; no other camera's are kept
    sound      whether the operator's log holds the vehicle's sound
    keep_gb    what the drives of `drives=DIR` may take, 10^9 bytes; None: any size
    keep_days  age from which they are removed; None: none
    """

    video: bool = False
    lossless: Mapping[str, Lossless] = field(default_factory=dict)
    sound: bool = False
    keep_gb: float | None = None
    keep_days: float | None = None

    @staticmethod
    def of(data: Mapping[str, Any], cameras: Collection[str]) -> LogSettings:
        """From the section `log` of a configuration.

        raises  ModelError for a camera that is not mounted, and for lengths that contradict each other
        """
        kept: dict[str, Lossless] = {}
        for name, own in data.get("lossless", {}).items():  # older drives have none
            if name not in cameras:
                raise ModelError(f"lossless.{name}", repr(name), f"no such camera{suggest(name, cameras)}")
            kept[name] = one = Lossless(**own)
            if one.for_s > one.every_s:
                rule = f"must be at most every_s, {one.every_s:g}"
                raise ModelError(f"lossless.{name}.for_s", f"{one.for_s:g}", rule, f"lossless.{name}.every_s")
        return LogSettings(**{**data, "lossless": kept})


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """A vehicle, and the settings of its run.

    recording   how frames are stored without loss, by `record` and by `log.lossless`
    expires_s   age from which the vehicle drops a request, in addition to the round trip
    log         what is logged, and which drives stay
    latency     limit of the speed by latency
    keys        directory made for this side by `tod-runner keys`; None: nothing is encrypted or authenticated
    insecure    whether that is intended although video or control leave this machine
    private     network on whose addresses it is intended; None: none
    strict      whether a vehicle starts only if every camera opens and its log can be written
    metrics     ports at which both sides serve metrics for Prometheus
    ros         the ROS node, for cameras whose source subscribes to topics
    dimensions  None: unknown
    inputs      keys and buttons of the operator's page
    uplinks     by name, in order; none: the system's routes decide by which way the vehicle sends
    sound       of the vehicle; None: none is sent
    voice       of the operator; None: the vehicle has no loudspeaker
    """

    vehicle: Vehicle
    media: Media
    control: Control
    page: PageSettings
    recording: Recording
    expires_s: float
    log: LogSettings = LogSettings()
    latency: LatencyLimit = LatencyLimit()
    keys: str | None = None
    insecure: bool = False
    private: IPv4Network | IPv6Network | None = None
    strict: bool = False
    metrics: MetricsPorts = MetricsPorts()
    ros: RosSettings = RosSettings()
    dimensions: Dimensions | None = None
    inputs: Inputs = Inputs()
    uplinks: Mapping[str, Uplink] = field(default_factory=dict)
    sound: Sound | None = None
    voice: Voice | None = None

    def with_cameras(self, cameras: Mapping[str, Camera]) -> Setup:
        """The same, of a vehicle with these cameras."""
        return replace(self, vehicle=replace(self.vehicle, cameras=cameras))


def address_rule(address: str) -> str | None:
    """The rule that an IP camera's address breaks; None: none. One without a scheme is left to its source."""
    if has_password(address):
        return "must not contain user or password: write user:password to a file, and name that as credentials"
    try:
        parts = urlsplit(address)
        is_complete = not parts.scheme or bool(parts.hostname and (parts.port is None or parts.port))
    except ValueError:  # a port that is no number, or brackets that do not match
        is_complete = False
    return None if is_complete else "must name a host, as rtsp://10.0.0.11/stream does"
