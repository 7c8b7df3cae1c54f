"""What the commands do, for Python: each verb takes what its command takes, or the same already loaded."""
