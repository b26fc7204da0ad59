import { Component, type ErrorInfo, type ReactNode } from "react";

import { ErrorMessage } from "../shared/ui/parts";

/** Catches errors of one page, so that the others stay usable. */
export class ErrorBoundary extends Component<{ children: ReactNode }, { fault: Error | null }> {
  override state: { fault: Error | null } = { fault: null };

  static getDerivedStateFromError(fault: Error): { fault: Error } {
    return { fault };
  }

  override componentDidCatch(error: Error, info: ErrorInfo): void {
    console.error(error, info.componentStack);
  }

  override render(): ReactNode {
    const { fault } = this.state;
    if (fault === null) return this.props.children;
    return <ErrorMessage text={`Error on this page: ${fault.message}`} again={() => this.setState({ fault: null })} />;
  }
}
