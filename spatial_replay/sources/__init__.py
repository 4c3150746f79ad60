"""Sources: every format that a log may have, behind one function that opens it."""
