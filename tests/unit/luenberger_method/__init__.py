"""A method in a folder of its own: the example of CONTRIBUTING.  An observer with one number as its gain."""
