"""What one process of a system has: its loop, its connections, the registrars and actors that live in it."""
