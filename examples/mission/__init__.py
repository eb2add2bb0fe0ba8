"""The parts of the mission: a simulated corridor, the programs of a robot in it, and the action that drives it."""
