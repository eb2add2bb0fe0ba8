"""Budgets: what resources may use together, of watts for example, and who gives way when that is not enough."""
