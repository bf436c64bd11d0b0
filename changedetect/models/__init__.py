"""Surface models behind one protocol."""
