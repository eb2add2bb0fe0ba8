"""The same across processes: references, proxies and asks that travel."""
