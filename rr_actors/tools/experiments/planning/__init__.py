"""Experiments of planning: budgets, programs that are needed, choices, what is kept, and graphs of actions."""
