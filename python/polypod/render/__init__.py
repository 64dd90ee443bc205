"""Pictures and films of robots, drawn on the processor. They need the `play` extra."""
