"""The experiments of the lab: small programs that show one thing each, slowly enough to be watched.

They are written as their readers would write them. The lab shows their text, runs each in a process of its own, and
draws the system that they start. The first line of each says what it is; "Look for:" says what to see.
"""
