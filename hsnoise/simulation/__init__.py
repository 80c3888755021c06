"""Captures drawn from a model as a measured one was taken, and the cameras of the paper.

May import all of the above and `likelihood`.
"""
