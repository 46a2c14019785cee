"""Reading and writing files: whole or not at all, protected inputs, digests, tables.

What the bytes mean stands in the room that knows: `specs`, `results`, `monitoring.logs`, `exporting`.

Main names: `read_document`, `write_atomically`, `output_file`, `protect`.
"""
