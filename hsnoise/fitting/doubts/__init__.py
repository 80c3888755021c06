"""Where a fit disagrees with its frames, and what is therefore withheld.

May import `fitting` and whatever that may import.
"""
