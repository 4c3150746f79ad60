"""The messages of our own topics, generated from the schemas; field comments there give units."""
