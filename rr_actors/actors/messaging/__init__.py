"""Messages within a process: mailboxes, futures, reports of exits, and messages that reached no actor."""
