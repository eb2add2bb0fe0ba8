"""The experiments of the lab: small programs that show one thing each, slowly enough to be watched.

They are written as an application would be. The lab shows their text, runs each in a process of its own, and draws
the system that it starts. The first line of each is its title; "Look for:" says what its reader can see. Its levers,
and the question that is asked before it runs, are declared in rr_actors/tools/web/lab/lab_catalog.py.
"""
