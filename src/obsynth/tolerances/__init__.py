"""What holds for every plant in the box of its constants."""
