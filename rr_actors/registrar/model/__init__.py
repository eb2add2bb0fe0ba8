"""The data of a registrar: rows, messages, commands, effects, and the catalog that holds them."""
