"""Training of the enhancer and its evaluation: clips, noisy examples, steps, checkpoints, rivals.

May import what `enhance` may import.
"""
