"""Image files: one module a format, which says what its pages are and reads one."""
