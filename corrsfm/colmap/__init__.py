"""Every conversation with pycolmap's data: its log, cameras, databases and models."""
