/** How the page asks about a moment of a capture. */

/** After this long the last moment of a drag counts. */
export const SETTLED_MS = 120;
/** Until an answer that failed is asked for again. */
export const PATIENT_MS = 1500;

/** Whether an answer says that there is nothing there; after any other error it is worth asking again. */
export const isNothing = (status: number): boolean => status === 404 || status === 422;
