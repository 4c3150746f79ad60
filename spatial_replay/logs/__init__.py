"""Our own logs and the track formats: their messages, samples and files."""
