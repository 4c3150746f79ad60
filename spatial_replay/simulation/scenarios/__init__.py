"""The scenarios of the package, each with a default specification."""
