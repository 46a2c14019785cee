"""The checks that methods share: every claim recomputed from the plant and the shipped realisation."""
