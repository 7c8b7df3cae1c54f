"""A scenario and all that is built, flown and audited from it."""
