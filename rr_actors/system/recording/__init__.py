"""Recording: what happened in a system, joined into traces: sequence diagrams, spans, figures."""
