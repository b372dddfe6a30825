"""Layout of captures, mattes, uploads and composites in the store, as arrays and bytes."""
