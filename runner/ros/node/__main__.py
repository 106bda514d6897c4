"""usage: python __main__.py SOCKET

The ROS node: see `start`. SOCKET is the number of an open socket (AF_UNIX, SOCK_SEQPACKET).
"""

import os
import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

PACKAGE = "tod_runner_node"

if __name__ == "__main__":
    # Loaded by location: on the path, its modules might shadow others of the same names. Python 3.10 has no option -P.
    here = Path(__file__).parent
    sys.path[:] = [path for path in sys.path if path != str(here)]
    spec = spec_from_file_location(PACKAGE, here / "__init__.py", submodule_search_locations=[str(here)])
    assert spec
    sys.modules[PACKAGE] = module_from_spec(spec)
    status = import_module(f"{PACKAGE}.start").start(int(sys.argv[1]))
    os._exit(status)  # rospy threads that wait for other nodes would keep the process alive
