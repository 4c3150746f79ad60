"""The version of this package, as logs and results store it."""

__version__ = "0.2.0"
