"""Our own logs and the track formats: messages, samples, and files of both."""
