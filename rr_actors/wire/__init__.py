"""Messages between processes: sockets, frames, handshake, and the names they are found by. Contract: transport.py."""
