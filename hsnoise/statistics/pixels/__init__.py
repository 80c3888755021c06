"""Single pixels over time: survey, classes, pixel transfer, populations, flags, maps.

May import `_core`, `frames` and `statistics`.
"""
