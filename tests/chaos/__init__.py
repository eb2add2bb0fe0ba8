"""Chaos: run a real system of real processes, harm it at random from a seed, and then check it against its promises.

`run.py` begins and ends a run. `victim_system.py` is the system, `victim_managers.py` has its managers, and
`load_threads.py` the threads that load from it. `monkey.py` harms it, and `process_census.py` finds its processes.
`callback_log.py` records the callbacks, `invariants.py` checks the catalogs, `report.py` counts. `watchdog.py` ends
a run that hangs. `soak.py` measures growth under the same load without harm. `breakages.py` breaks the product on
purpose, and `test_breakages.py` checks that chaos notices it.
"""
