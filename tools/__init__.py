"""What the project uses to write its own documents and to measure itself; not part of the package."""
