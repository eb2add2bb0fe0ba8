"""The Resource Registrar: its public classes are here, its decisions in core, its actions in engine and links."""
