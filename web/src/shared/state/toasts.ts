/** Short messages at the edge of the page, some with an action. */

import { create } from "zustand";

export interface Toast {
  id: number;
  text: string;
  tone: "note" | "problem";
  action?: { label: string; run: () => void };
}

const SHOWN_MS = 8000;
let next = 1;

export const useToasts = create<{ toasts: Toast[] }>(() => ({ toasts: [] }));

export function dismiss(id: number): void {
  useToasts.setState((state) => ({ toasts: state.toasts.filter((toast) => toast.id !== id) }));
}

export function toast(text: string, options: Partial<Pick<Toast, "tone" | "action">> = {}): void {
  const id = next++;
  useToasts.setState((state) => ({ toasts: [...state.toasts.slice(-3), { id, text, tone: "note", ...options }] }));
  setTimeout(() => dismiss(id), SHOWN_MS);
}
