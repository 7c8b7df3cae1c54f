"""Where the control law leads: straight to the goal, or down the travel time to it."""
