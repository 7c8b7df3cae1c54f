"""Truths and worlds that several test files share."""
