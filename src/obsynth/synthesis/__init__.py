"""From a plant to gains, a realisation and a certificate."""
