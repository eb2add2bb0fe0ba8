"""The parts of one process of a system: its loop, its connections, and the registrars and actors in it."""
