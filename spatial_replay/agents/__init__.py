"""A server that agents call: the commands as tools of the Model Context Protocol."""
