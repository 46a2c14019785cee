"""Observers whose matrices change with measured parameters.

`observer` has the observer; the plants that it is for are `obsynth.plants.polytopic`.
"""
