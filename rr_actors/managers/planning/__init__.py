"""The common base of the managers that plan: one loop, back-off, records that are kept, whose fault a failure is."""
