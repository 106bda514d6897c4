#!/usr/bin/env bash
# `ip route get HOST oif DEVICE` shows a route where there is none.
#
# If no route leads to a host by a device, the kernel takes the host for a neighbour there, both in this answer and for
# a socket that is bound to the device (SO_BINDTODEVICE). sendto succeeds; on Ethernet nobody answers for the hardware
# address, and the packet is dropped without a word. Only `ip route get fibmatch` tells.
#
# Debian 12: iproute2 6.1.0-3, with Linux 6.18. As root, in a network namespace of its own.
# Output seen: "route get: dev one; fibmatch: none; sendto: fine". Ends with another status than 0 if that changes.
set -eu
. "$(dirname "$0")/pinned"
pinned iproute2=6.1.0-3
export place
seen=$(unshare --net bash -eu <<'SHELL'
PATH="$place/root/bin:$place/root/sbin:$PATH"
ip link add one type veth peer name other
ip link set one up
ip link set other up
ip address add 10.1.0.2/24 dev one
route=$(ip route get 10.9.0.1 oif one | grep -o "dev one")
matched=$(ip route get fibmatch 10.9.0.1 oif one 2>/dev/null || echo none)
sent=$(/usr/bin/python3 - <<'PYTHON'
import socket
out = socket.socket(type=socket.SOCK_DGRAM)
out.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"one")
try:
    out.sendto(b"x", ("10.9.0.1", 9))
    print("fine")
except OSError as error:
    print(error.strerror)
PYTHON
)
echo "route get: $route; fibmatch: $matched; sendto: $sent"
SHELL
)
echo "$seen"
test "$seen" = "route get: dev one; fibmatch: none; sendto: fine"
