"""System: a supervisor tree and a state directory, where an application begins; and views of it."""
