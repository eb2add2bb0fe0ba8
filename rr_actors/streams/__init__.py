"""Streams: a flow of values from the manager of a resource to those who hold it, beside the registrar.

The two ends are Publisher and StreamReader. A Publisher listens on a socket whose name is the resource's id and the
stream's name. A reader connects to it, and sends a byte for each frame that it can take. Large frames go through
shared memory (rr_actors/wire/segments.py).
"""
