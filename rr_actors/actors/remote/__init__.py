"""Messages between processes: references, proxies and asks that travel."""
