import { Component, type ErrorInfo, type ReactNode } from "react";

import { Trouble } from "../ui/parts";

/** A fault in one page leaves the others usable. */
export class Guard extends Component<{ children: ReactNode }, { fault: Error | null }> {
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
    return <Trouble text={`This page has a fault: ${fault.message}`} again={() => this.setState({ fault: null })} />;
  }
}
