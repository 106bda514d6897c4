"""All benchmarks in one table and one JSON file, with machine and date.

  python bench                       twenty minutes on an otherwise idle machine; rows go to bench.json
  python bench OUT.json cost link    a selection

Where bare GStreamer can do the same, both are measured in pairs, with a ratio: bench/cost.py.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path

from table import as_json, show, write

BENCHES = ("cost", "memory", "live", "link", "page", "replay", "validate", "pqos_map")


def main(arguments: list[str]) -> int:
    path = Path(arguments[0] if arguments else "bench.json")
    chosen = arguments[1:] or BENCHES
    if unknown := [name for name in chosen if name not in BENCHES]:
        print(f"unknown bench {', '.join(unknown)}; expected one of {', '.join(BENCHES)}", file=sys.stderr)
        return 2
    rows = []
    for name in chosen:
        began = time.monotonic()
        print(f"{name} ...", end=" ", flush=True, file=sys.stderr)
        rows += importlib.import_module(name).rows()
        print(f"{time.monotonic() - began:.0f} s", file=sys.stderr)
        write(rows, path)  # keeps these results if the next one fails
    print(json.dumps({key: value for key, value in as_json(rows).items() if key != "rows"}))
    show(rows)
    return 0 if all(row.is_acceptable for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
