"""What actors exchange within a process: mailboxes, futures, exits, and messages that reached nobody."""
