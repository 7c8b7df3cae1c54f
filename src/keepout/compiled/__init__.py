"""How programs are compiled for this machine: compiler options, one kernel a step, evaluation on demand."""
