"""Chaos: a real system of real processes, harmed at random from a seed, and then checked against its promises.

`run.py` begins and ends it. `victim_system.py` is the system, `victim_managers.py` has its managers and actors, and
`load_threads.py` the threads that load from it. `monkey.py` harms it, and `process_census.py` finds its processes.
`callback_log.py` records what callbacks do, `invariants.py` checks the catalogs, `report.py` counts. `watchdog.py` ends
a run that hangs. `soak.py` watches the same load without harm for growth.
"""
