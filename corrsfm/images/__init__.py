"""Photos: their list, cameras, positions and pixels."""
