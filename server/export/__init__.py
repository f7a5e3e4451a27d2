"""What a run leaves behind, and its forms for other tools."""
