"""Flight: one step shared by single flights, batches and real-time use; what can fail in it; and its record."""
