"""How improbable a contact is where nothing is proved: subset simulation on the noise of a flight, measured."""
