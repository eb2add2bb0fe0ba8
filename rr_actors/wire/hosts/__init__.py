"""Links between hosts, over Eclipse Zenoh; the extra "hosts" installs it."""
