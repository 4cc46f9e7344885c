"""Readers, a file per layout of published data sets; `layouts.reader` imports one."""
