"""Control of the interfaces that direct links go over: one class for each way in which a technology is controlled."""
