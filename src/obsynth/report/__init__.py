"""What people read: tables, the HTML page, and the pictures in `plots`.

Main names: `summary`, `html_report`, `check_report`; pictures are public as ``obsynth.plotting``.
"""
