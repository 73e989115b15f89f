"""Links between the points of two states, and the motion that they tell."""
