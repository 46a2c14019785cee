"""The methods: analyse, synthesise, verify, and hand over an `ObserverDesign`."""
