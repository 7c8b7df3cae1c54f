"""Flights and fields in files of other programs' formats, written and read; and the audit of a flight from such files.

It stands above the mission and below the pages: nothing that flies or proves imports it.
"""
