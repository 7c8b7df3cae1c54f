"""Flight: one step shared by single flights and campaigns, and an independent audit."""
