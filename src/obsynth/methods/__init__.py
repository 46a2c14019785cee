"""The doors: analyse, synthesise, verify, and hand over an `ObserverDesign`."""
