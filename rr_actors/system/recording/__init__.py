"""Recording: the entries of a system's processes, joined into traces: sequence diagrams, spans, figures."""
