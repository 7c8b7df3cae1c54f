"""Reports: figures, tables and pages to open."""
