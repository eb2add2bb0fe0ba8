"""Rewound: the state of a system at any moment of a recording, folded from what was recorded."""
