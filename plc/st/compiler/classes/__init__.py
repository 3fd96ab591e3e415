"""The methods and properties to which references refer."""
