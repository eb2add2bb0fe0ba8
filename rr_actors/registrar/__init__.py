"""The Resource Registrar: what people call is here; what it decides is in core, what it does in engine and links."""
