"""What of a fit disagrees with its frames, and what is therefore withheld.

May import `fitting` and what it may.
"""
