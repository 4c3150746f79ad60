"""The worlds that ship with the package, each with a specification of what its robot should do."""
