"""The frame of the web pages: their addresses, their looks, and what the drawer and the overview say."""
