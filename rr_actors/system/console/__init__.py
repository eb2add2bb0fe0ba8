"""The console: how another process of this user looks at a running system, hears what happens in it, and drives it."""
