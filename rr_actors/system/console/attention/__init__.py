"""What needs attention in a running system: the rules, what is asked for them, and the console's question."""
