"""The methods: from options and a plant to gains, and to the checks of their claims.

One folder for each method: `method` (the class whose fields are its options), `synthesis`, `realisation`, `checks`;
`engines` holds what several methods compute with; `designing` is the way to a verified design. The papers'
inequalities stand in `conditions`.

Main names: `design`, `check`, `verify`, `Method`, `REGISTRY`.
"""
