"""System: a supervisor tree and a state directory, where an application begins; and what can be seen of it."""
