"""What a capture is and what it can determine, before any fit: `inspect`.

May import what `criticism` may.
"""
