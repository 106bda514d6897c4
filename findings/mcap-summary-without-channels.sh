#!/usr/bin/env bash
# mcap 1.6.0 (Python, PyPI; the reader of the format's authors) raises KeyError on a valid file of its own writer.
#
# The MCAP specification lets a writer leave channels and schemas out of the summary section; they then are in the
# chunks only. mcap's Writer offers this (repeat_channels=False, repeat_schemas=False). make_reader() of the same
# library reads the chunk index from the summary, and looks up the channel of each message there and nowhere else, so a
# file on disk ends in KeyError; the same bytes read as a stream (NonSeekingReader) give all messages.
#
# Seen on Debian 12, Python 3.11.2, mcap 1.6.0:
#   whole summary:     seeking 20, streaming 20
#   without channels:  seeking KeyError(1), streaming 20
#   without schemas:   seeking KeyError(1), streaming 20
#
# A reader that must read what others write checks that the summary describes every channel that its statistics count,
# and scans the file once if it does not.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/venv"
"$place/venv/bin/pip" install --quiet --disable-pip-version-check mcap==1.6.0 lz4==4.4.5 zstandard==0.25.0
"$place/venv/bin/python" - <<'EOF'
import io

from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer


def written(**options):
    file = io.BytesIO()
    writer = Writer(file, chunk_size=200, **options)
    writer.start("", "")
    channel = writer.register_channel("/t", "json", writer.register_schema("a", "jsonschema", b"{}"))
    for number in range(20):
        writer.add_message(channel, number, b'{"number": %d}' % number, number)
    writer.finish()
    file.seek(0)
    return file


def count(reader):
    try:
        return sum(1 for _ in reader.iter_messages())
    except KeyError as error:
        return repr(error)


found = {}
for name, options in {
    "whole summary": {},
    "without channels": {"repeat_channels": False},
    "without schemas": {"repeat_schemas": False},
}.items():
    found[name] = count(make_reader(written(**options))), count(NonSeekingReader(written(**options)))
    print(f"{name}: seeking {found[name][0]}, streaming {found[name][1]}")
expected = {"whole summary": (20, 20), "without channels": ("KeyError(1)", 20), "without schemas": ("KeyError(1)", 20)}
raise SystemExit(found != expected)
EOF
