"""Control: from a field and a goal to a commanded force."""
