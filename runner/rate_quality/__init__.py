"""Rate-quality models, measured offline with the encoder of the live graph (paper, sections III and V-A).

    sequence -> plans -> sweep -> task (lanes, metrics) -> Point -> curves -> choice -> artefact, plots

`measure.py` runs this chain for each camera. `curves`, `plans`, `choice`, `lanes` and `compare` are pure.
"""
