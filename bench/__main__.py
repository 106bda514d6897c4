"""All figures in one table and one JSON, with machine and date.

  python bench                       twenty minutes on an otherwise idle machine; rows go to bench.json
  python bench OUT.json cost link    some of them

What bare GStreamer does as well is measured in pairs beside it, with a ratio: bench/cost.py.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path

from table import as_json, show, write

BENCHES = ("cost", "memory", "live", "link", "page", "replay", "validate", "pqos_map")


def main(words: list[str]) -> int:
    path = Path(words[0] if words else "bench.json")
    chosen = words[1:] or BENCHES
    if unknown := [name for name in chosen if name not in BENCHES]:
        print(f"unknown bench {', '.join(unknown)}; expected one of {', '.join(BENCHES)}", file=sys.stderr)
        return 2
    rows = []
    for name in chosen:
        began = time.monotonic()
        print(f"{name} ...", end=" ", flush=True, file=sys.stderr)
        rows += importlib.import_module(name).rows()
        print(f"{time.monotonic() - began:.0f} s", file=sys.stderr)
        write(rows, path)  # what was measured is kept, whatever the next one does
    print(json.dumps({key: value for key, value in as_json(rows).items() if key != "rows"}))
    show(rows)
    return 0 if all(row.is_acceptable for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
