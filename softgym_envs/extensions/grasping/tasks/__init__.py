"""Tasks of hands: grasp and lift."""
