"""Readable reports: tables of a design, its checks, and the structure of a plant."""
