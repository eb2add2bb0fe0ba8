"""Chaos: a real system of real processes, harmed at random from a seed, and in the end checked against its promises.

`run.py` begins and ends it, `plant.py` is the system, `managers.py` what runs in its processes, `consumers.py` who
loads from it, `monkey.py` what harms it, `census.py` whom; `journal.py` and `checks.py` are the witnesses, `tally.py`
counts, `watch.py` sees that it ends, `soak.py` watches the same load without harm for what grows.
"""
