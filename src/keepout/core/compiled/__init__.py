"""How programs are compiled for this machine, and kept: options, one kernel a step, evaluation on demand."""
