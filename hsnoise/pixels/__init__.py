"""Pixels over time: what stays in a pixel, what changes, and the gain that follows. Sees `stack` and below."""
