"""The mission of the plant that is harmed: what is chosen, what is kept, and graphs of actions.

`mission_managers.py` has its managers and its graph, `mission_threads.py` the operators that use them.
`mission_part.py` adds it to the plant, and `mission_checks.py` has its invariants.
"""
