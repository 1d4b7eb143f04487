//! What is learned from the numbers of a campaign: how grades foretell force errors, what labels cost. Plain numbers in
//! and out; where they come from, and how they are shown, is not known here.
