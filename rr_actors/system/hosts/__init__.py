"""The gateway to systems on other hosts: what System(hosts=...) starts."""
