"""The lists that are shown: each is declared once, and the command line, `top` and the web pages draw it."""
