"""Chaos: a real system of real processes, harmed at random from a seed, and in the end checked against its promises.

- `run.py` begins and ends a run. `watchdog.py` sees that it ends. `report.py` counts.
- `victim_system.py` is the system, `victim_managers.py` what runs in its processes.
- `load_threads.py` loads from it.
- `monkey.py` harms it; `process_census.py` says which processes there are.
- `callback_log.py` and `invariants.py` are the witnesses.
- `soak.py` watches the same load without harm, for what grows.
"""
