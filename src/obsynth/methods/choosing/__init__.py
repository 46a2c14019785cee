"""Which method to take: figures of designs on one clock, and the choice by default."""
