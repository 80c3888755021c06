"""Single pixels over time: survey, classes, photon transfer pixel by pixel, populations, flags, maps.

May import `_core`, `frames` and `statistics`.
"""
