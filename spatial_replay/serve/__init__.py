"""The live server: viewers connect to a replay, move in time, and change the specification's constants."""
